"""What a sibling adds: failures against road features, and against other siblings' failures."""

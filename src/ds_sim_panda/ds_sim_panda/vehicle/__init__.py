"""Motion of the third sibling: a published multi-body model."""

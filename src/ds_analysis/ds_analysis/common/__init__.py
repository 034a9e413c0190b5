"""Tables, charts and statistics that several analyses share."""

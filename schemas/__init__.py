"""The wire format as JSON Schema, one file per message and version."""

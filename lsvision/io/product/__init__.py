"""Products on disk: layout, writing, reading, checking, export."""

"""A local page on which a product of any length is looked at: tiles of its pyramids, sections, distances."""

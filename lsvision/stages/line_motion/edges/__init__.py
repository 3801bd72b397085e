"""Straight edges of a flat object along its travel: they show how it moves sideways, which its profile does not."""

"""Dense matching of a rectified pair: search, sub-pixel refinement, agreement of the two views."""

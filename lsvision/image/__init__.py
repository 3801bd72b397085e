"""Operations on image tensors: checkerboard corners, matching, visible-surface maps, resampling."""

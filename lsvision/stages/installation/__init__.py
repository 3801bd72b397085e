"""The motion -> how to turn the cameras and what line pitch to set, so that the object moves as it nominally does."""

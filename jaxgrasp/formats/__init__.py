"""Grasp sets in and out, one file a format."""

"""Hierarchies of bounding boxes."""

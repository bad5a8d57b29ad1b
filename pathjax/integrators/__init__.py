"""Estimators of the rendering equation."""

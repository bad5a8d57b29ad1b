"""Derivatives of images in what materials and lights are made of."""

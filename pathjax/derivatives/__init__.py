"""Derivatives of images with respect to the parameters of materials, lights and media."""

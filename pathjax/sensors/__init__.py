"""Cameras and films."""

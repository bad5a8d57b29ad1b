"""Mitsuba's scene files."""

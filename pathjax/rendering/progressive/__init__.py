"""Renders that go on until an error is reached."""

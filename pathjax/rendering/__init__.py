"""Images and queries, from a scene."""

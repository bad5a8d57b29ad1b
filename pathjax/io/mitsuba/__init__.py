"""Read and write Mitsuba's scene files and dictionaries."""

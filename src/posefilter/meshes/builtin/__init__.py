"""The objects that the project draws itself."""

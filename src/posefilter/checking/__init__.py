"""Check whether a dataset fits its meshes."""

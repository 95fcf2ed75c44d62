"""Readers, meshes, scenes and loaders: everything above sees metres, the mesh file's frame and OpenCV cameras only."""

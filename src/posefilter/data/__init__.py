"""Readers, meshes, scenes and loaders: everything above sees meters, the mesh file's frame and
OpenCV cameras only.
"""

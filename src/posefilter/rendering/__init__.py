"""Render color, depth and labels of meshes."""

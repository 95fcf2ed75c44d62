"""Readers of FAT, YCB-Video and BOP datasets."""

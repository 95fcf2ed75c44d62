"""Measures of estimates and beliefs: pure functions, and torchmetrics classes that collect them
over a test.
"""

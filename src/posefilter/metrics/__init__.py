"""Metrics of estimates and beliefs: pure functions, and torchmetrics classes that accumulate
them.
"""

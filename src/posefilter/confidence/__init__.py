"""Whether the object is there and its pose right: evidence, a calibrated probability, a verdict."""

"""Whether the object is there and its pose right: features, a calibrated probability, a verdict."""

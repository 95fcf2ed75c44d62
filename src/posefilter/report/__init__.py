"""One HTML page that explains a run or a sweep: what is in its folder, gathered, drawn and laid
out.
"""

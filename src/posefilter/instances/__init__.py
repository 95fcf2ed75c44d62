"""Several objects in one image: many of one class, many classes, no two on the same pixels.

A filter finds one instance at a time.  What is found is taken out of the image before the next
search: a network that was trained on images of one instance sees the clearest one and denies the
others, and with that one gone it sees the next.
"""

"""The methods: each a LightningModule, short, since base.py holds every hook and the pieces are
injected.
"""

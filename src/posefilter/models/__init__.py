"""The methods: each a short LightningModule, since base.py has every hook."""

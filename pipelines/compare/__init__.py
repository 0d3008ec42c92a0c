"""Ablation of the method on one survey: `georef compare`."""

"""`georef compare`: the ablation of the method on one survey."""

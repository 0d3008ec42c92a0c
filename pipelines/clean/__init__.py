"""Stage `clean`: a model without floaters, of fewer Gaussians, made from the trained one."""

"""Geographic half of the joint optimisation: the adjustment's unknowns and terms as tensors with gradients."""

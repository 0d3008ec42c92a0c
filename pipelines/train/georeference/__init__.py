"""What holds a training to the Earth: its unknowns as tensors, and the losses on them."""

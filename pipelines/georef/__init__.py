"""Geographic losses and their weights, the learnable similarity, and the corrections of the cameras."""

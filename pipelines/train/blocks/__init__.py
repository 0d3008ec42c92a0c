"""Training in blocks: a survey is divided, its blocks are trained apart, and merged."""

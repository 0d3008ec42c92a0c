"""Multi-view stereo: a depth for every pixel, from photographs whose cameras are known."""

"""Multi-view stereo: depth maps from photographs whose cameras are known."""

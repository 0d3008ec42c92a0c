"""Stage `calibrate`: time offset, boresight and lever arm from the SfM cameras and the recorded navigation."""

"""Batch of missions: `georef batch`. A mission is a workspace with the options of its `georef run`."""

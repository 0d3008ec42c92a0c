"""Where the surface is: stereo, depth maps, fusion, visibility, picking, measured clouds and registration."""

"""Products of frames and flights: geotags, maps, exports and batches. Everything here runs on the ground."""

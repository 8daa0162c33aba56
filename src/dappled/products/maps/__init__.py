"""Make maps, terrain and footprints from a flight's frames."""

"""Lenses, masks, carrier laws, film, laser bench, mask and survey design, carrier tables."""

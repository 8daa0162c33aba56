"""What stopped-down frames tell of a masked camera: lattice, law, transfer, print scale."""

"""`dappled terrain volume|contours`: what the heights of maps tell."""

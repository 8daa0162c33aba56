"""Settings, camera and mask profiles, and the errors of both, which name file, line and key."""

"""Raw files: read, made linear, and decoded by a recipe."""

"""Light fields, pictures and point clouds as files."""

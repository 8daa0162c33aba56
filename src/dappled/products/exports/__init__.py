"""Read and write files of light fields, pictures, masks and point clouds."""

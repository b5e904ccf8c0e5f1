"""Files of medical images: label maps, meshes, markups and transforms of 3D Slicer; their frames."""

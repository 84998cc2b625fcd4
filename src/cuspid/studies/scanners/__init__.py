"""Studies of any scanner: trueness and precision from folders of meshes."""

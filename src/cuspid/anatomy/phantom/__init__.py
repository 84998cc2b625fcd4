"""Jaws that are built: phantoms of teeth and gum, populations of them, and an arch of spheres."""

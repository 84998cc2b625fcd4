"""One camera: where its photographs or frames were taken, and their scale."""

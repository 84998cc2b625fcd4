"""The nouns: rig, camera, capture, mesh, jaw, board, reconstruction, trueness, panorama; and what the cameras see."""

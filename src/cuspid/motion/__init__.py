"""Where the handpiece was: features, lean pairs, odometry, one bundle adjustment. The only import of pycolmap."""

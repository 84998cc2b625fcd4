"""Videos and folders of images become a capture: synchronised, without blurred, dark, burnt-out or duplicate images."""

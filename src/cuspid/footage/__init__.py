"""Videos and folders of images become a capture: synchronised, without what is blurred, dark, burnt or twice there."""

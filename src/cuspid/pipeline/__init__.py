"""The flow: a scan, photographs of one camera, a panorama, and a scan while it is taken."""

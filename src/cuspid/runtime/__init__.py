"""What every room stands on, and what knows nothing of scanning: options, checked values, files, errors, work."""

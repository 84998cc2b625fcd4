"""The shape of jaws: the mean of many, and one with a box for each tooth."""

"""Where the handpiece was: features, lean pairs, odometry, one bundle adjustment. Only this package knows pycolmap."""

from cuspid.runtime.signals import preserve_handlers

with preserve_handlers():  # pycolmap's prints the stack of its own code at SIGTERM
    from cuspid.motion.bundle.adjustment import AdjustmentOptions, adjust
    from cuspid.motion.location import MotionOptions, locate

__all__ = ["AdjustmentOptions", "MotionOptions", "adjust", "locate"]

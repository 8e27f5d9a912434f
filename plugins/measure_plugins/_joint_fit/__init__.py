"""The joint fit of one pose to all outline points of all balls in all cameras."""

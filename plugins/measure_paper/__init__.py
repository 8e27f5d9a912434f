"""The method of the 2020 paper: equation 3, Hough circles, midpoints, and a simplex search."""

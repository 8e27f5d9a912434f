"""The method of the 2020 paper: Hough circles, midpoints of rays, and a simplex search."""

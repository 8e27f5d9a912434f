"""From edges along rays to an outline: bias correction, robust cone fit and covariance."""

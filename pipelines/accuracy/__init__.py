"""Predicted covariance of any point of a trained survey, propagated from the covariances of its measurements."""

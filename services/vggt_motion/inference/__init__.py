"""Geometry prediction: the predictor contract, the predictors behind it, and the inference worker."""

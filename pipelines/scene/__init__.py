"""Survey and model as the stages share them: products as types, and the computations of several stages on them."""

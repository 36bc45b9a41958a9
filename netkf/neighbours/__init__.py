"""Results and models in the forms of other libraries: the only room that speaks them."""

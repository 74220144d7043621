"""What a measurement says about the unknowns: factors and the mathematics under them."""

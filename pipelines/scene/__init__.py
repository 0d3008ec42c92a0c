"""What stages share about a survey: the products as types, and what several stages make of them."""

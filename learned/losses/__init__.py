"""What training without labels minimises: small terms, and the methods' own combinations of them."""

"""What there is to see: sites with ground, plants and buildings, and rays that meet them."""

"""What a diagnosis leaves open of an arm: its members, and the costs of designs in each."""

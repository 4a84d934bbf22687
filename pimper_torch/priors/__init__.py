"""What guesses from elsewhere mean, and guesses of networks."""

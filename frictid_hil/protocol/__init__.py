"""What a driver must bring, and the frames that it speaks."""

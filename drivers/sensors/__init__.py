"""What measures distance, profile, displacement or force: codec and driver of each."""

"""Speed, side by side in one run: ratios are the result, absolute times belong to the machine."""

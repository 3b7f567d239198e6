"""What the stage reports of its result, and the advice it gives."""

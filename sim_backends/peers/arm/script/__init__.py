"""The script ports of the controller, and the commands of the control script."""

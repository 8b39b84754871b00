"""What has changed since the calibration: reference plate, slip, roll, timing, verification."""

"""RTDE version 2, server side."""

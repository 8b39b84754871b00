"""The sequence as data: states, transitions, guards, deadlines, retries and the durable journal."""

"""Days with faults: random schedules of faults and people's acts on whole virtual jobs, and a judge of their own."""

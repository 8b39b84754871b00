"""What a run leaves for other programs: `record.mcap`, its repair and its export; and perception fed with it again."""

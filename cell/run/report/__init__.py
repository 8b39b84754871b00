"""What a run leaves for people and scripts: `report.json`, tables, pictures, exports."""

"""The laser stripe in pictures: found and measured in every line, each centre with its standard deviation."""

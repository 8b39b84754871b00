"""An open cell: opened, held as `Cell`, and warmed up before its first job."""

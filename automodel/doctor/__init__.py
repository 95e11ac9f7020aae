"""What `automodel doctor` makes of what it measures: values in, findings out; the measuring is in `automodel.cli`."""

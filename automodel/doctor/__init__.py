"""`automodel doctor`: checks a car and its machine; each check gives one finding."""

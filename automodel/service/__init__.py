"""The car as a service of systemd: told that it is ready and alive, installed, looked after."""

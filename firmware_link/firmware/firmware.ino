// The Arduino IDE opens this file and builds src/ with it. The program, main() too, is in src/nano/main.cpp.

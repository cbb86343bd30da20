"""Bus: servos of one serial line for a script, on the exchange that the runtime uses.

`Bus` and `AsyncBus` open the line, `ServoSet` reads and writes single items, `ServoReader` and `ServoWriter`
exchange the same items again and again."""

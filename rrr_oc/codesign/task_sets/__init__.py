"""One set of springs for many tasks, each with a motion of its own.

`task_set` reads the set and states it as one problem; `set_search` solves it globally; `spring_choice` chooses which springs are
worth a price."""

"""One set of springs for many tasks, each with a motion of its own.

`task_set` reads the set and states it as one problem; `held_springs` finds a task's best motion while the springs are held, with the
derivatives of its cost by the springs; `descent` changes the springs; `set_search` solves a set globally; `set_study` goes through
all configurations of springs."""

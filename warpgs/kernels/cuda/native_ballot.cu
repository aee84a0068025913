return (int)__ballot_sync(0xffffffffu, wanted != 0);

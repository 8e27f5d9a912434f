"""Reading a picture along rays across an outline: where rays lie, pixels between pixels, edges."""

"""Pictures of what a filter saw and believes: arrays in, arrays or figures out.  Nothing here knows Lightning."""

-- An event's identity as text: station/source/type/sequence. A later life of a station's log begins its
-- sequences anew, so there the epoch stands before the sequence: station/source/type/2:17.
create function event_id(p_station text, p_epoch integer, p_source text, p_type text, p_sequence bigint) returns text
language sql immutable parallel safe as $$
  select p_station || '/' || p_source || '/' || p_type || '/'
    || case when p_epoch > 1 then p_epoch || ':' else '' end || p_sequence
$$;
